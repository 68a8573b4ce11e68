"""Benchmarks: each prints compile time apart from steady time, with repeats and spread, and writes the same as JSON."""
