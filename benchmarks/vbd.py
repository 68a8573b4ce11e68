"""Roll a garment by the vertex block descent of NVIDIA Newton, which this package does without: a process of its own.

    PYTHON benchmarks/vbd.py PROBLEM.npz ANSWER.npz

PYTHON has the package `newton` (`pip install newton`) and NumPy. `benchmarks/against_vbd.py` writes the problem and reads the
answer. Every number of iterations rolls its own trajectory from the same start: a step a frame, no friction, no damping.
The first step is taken twice, and the first time is not counted: kernels are compiled there.
"""

from __future__ import annotations

import sys
import time

import numpy as np

GAP = 0.05  # m: how far beyond the thickness contact is looked for, so that what is deep inside is found too


def model_of(problem, pipeline_class, builder_class, mesh_class):
    """Return Newton's model of the garment and its body, the body's mesh and how contact is found: both None without a body.

    Energies are set to be ours: contact 1/2 ke d^2 with ke = 2 k_c, where the shape's ke and the cloth's are averaged; bending
    1/2 ke L (phi - phi_rest)^2.
    """
    builder = builder_class(gravity=tuple(map(float, problem["gravity"])))
    rest, faces, hinges = problem["rest"], problem["faces"], problem["hinges"]
    mass = problem["mass"].copy()
    mass[problem["pins"]] = 0  # not moved by forces
    builder.add_particles(list(rest), [np.zeros(3)] * len(rest), list(mass), [float(problem["thickness"])] * len(rest))
    mu, lam, none = ([float(value)] * len(faces) for value in (problem["mu"], problem["lam"], 0.0))
    builder.add_triangles(*faces.T, tri_ke=mu, tri_ka=lam, tri_kd=none, tri_drag=none, tri_lift=none)
    if len(hinges):
        a, b, c, d = hinges.T
        stiff = 2 * problem["hinge_weight"] / np.linalg.norm(rest[b] - rest[a], axis=1)
        builder.add_edges(c, d, a, b, edge_ke=list(stiff), edge_kd=[0.0] * len(hinges))
    body = None
    if len(problem["body"]):
        body = mesh_class(problem["body"][0], problem["body_faces"].ravel(), compute_inertia=False)
        contact = builder_class.ShapeConfig(ke=2 * float(problem["stiffness"]), kd=0.0, mu=0.0, margin=0.0, gap=GAP)
        builder.add_shape_mesh(-1, mesh=body, cfg=contact)
    builder.color(include_bending=len(hinges) > 0)
    model = builder.finalize()
    if body is None:
        return model, None, None
    model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = 2 * float(problem["stiffness"]), 0.0, 0.0
    reach = float(problem["thickness"]) + GAP
    for bound, places in ((model.shape_collision_aabb_lower, problem["body"].min((0, 1)) - reach),
                          (model.shape_collision_aabb_upper, problem["body"].max((0, 1)) + reach)):  # fmt: skip
        bound.assign(places[None])  # of the whole motion: cloth outside of it is passed over
    return model, body.mesh, pipeline_class(model, soft_contact_gap=GAP, contact_matching="latest")


def roll(problem, iterations: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the positions (frames, verts, 3) after the start's, the seconds of each, and those of the step that compiles."""
    import newton
    import warp

    model, mesh, pipeline = model_of(problem, newton.CollisionPipeline, newton.ModelBuilder, newton.Mesh)
    slot, when = newton.solvers.SolverBase.CollisionSlot.RIGID, newton.solvers.SolverBase.CollisionFrequencyType
    often = {slot: when.ITERATIONS if problem["detect"] == "iteration" else when.PRE_INIT}
    seen = {} if pipeline is None else {"collision_pipeline": pipeline, "collision_frequency_type": often}
    solver = newton.solvers.SolverVBD(model, iterations=iterations, particle_enable_self_contact=False, **seen)
    states = [model.state(), model.state()]
    pins, dt = problem["pins"], 1 / float(problem["fps"])

    def step(t):
        before, after = states
        if mesh is not None:
            mesh.points.assign(problem["body"][t])
            mesh.refit()
        if len(pins):
            places = before.particle_q.numpy()
            places[pins] = problem["pinned"][t]
            before.particle_q.assign(places)
        solver.step(before, after, None, None, dt)
        warp.synchronize()
        states.reverse()
        return states[0].particle_q.numpy().copy()

    def begin():
        states[0].particle_q.assign(problem["start"])
        states[0].particle_qd.assign(problem["velocity"])

    frames = max(len(problem["body"]), len(problem["pinned"]), int(problem["frames"]))
    begin()
    at = time.perf_counter()
    step(1)
    compiling = time.perf_counter() - at
    begin()
    places, seconds = [], []
    for t in range(1, frames):
        at = time.perf_counter()
        places.append(step(t))
        seconds.append(time.perf_counter() - at)
    return np.array(places), np.array(seconds), max(0.0, compiling - seconds[0])


def main(problem_file: str, answer_file: str) -> int:
    """Read the problem, write the answer."""
    import newton
    import warp

    warp.config.quiet = True
    with np.load(problem_file) as file:
        problem = dict(file)
    rolled = [roll(problem, int(count)) for count in problem["iterations"]]
    vertices, seconds, compiling = (np.array(each) for each in zip(*rolled, strict=True))
    versions = f"newton {newton.__version__}, warp {warp.__version__}, {warp.get_device()}"
    np.savez(answer_file, vertices=vertices, seconds=seconds, compiling=compiling, versions=versions)
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
