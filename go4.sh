cd /work/h/s14/K; TF_CPP_MIN_LOG_LEVEL=3 PYTHONPATH=. taskset -c ${CPU:-0} nice -n 5 .venv/bin/python /work/h/s13/built/measure.py "$@" 2>&1 | grep -v "cpu_aot\|Target"
