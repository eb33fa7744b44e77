"""The jet-engine compressor in ten lines: one solve, one closed loop that learns. The cells run in a notebook too."""

# %% What both need
import numpy as np

from lbmpc import LinearOracle, Solver, build_model, build_problem, get_plant
from tandem import Loop

plant = get_plant("moore_greitzer")

# %% One solve: the input that linear MPC gives at x0
model = build_model(plant, period=0.05)
oracle = LinearOracle(model.d, model.m)
theta = oracle.theta(oracle.initial_state(np.random.default_rng(0)))
solver = Solver(build_problem(model, oracle, horizon=60))
solution = solver.solve(plant.x0 - plant.x_e, theta, np.zeros((60, model.m)))
print(f"one solve: {solution.status}, u = {plant.u_e + solution.v[0]}")

# %% One closed loop: 10 s with a network that learns what the model misses
result = Loop(plant, oracle="dnn").run(200)
print(f"closed loop: J = {result.summary.J:.3f}, overshoot of z {result.summary.overshoot['z']:.1%}")
result.plot().savefig("compressor.png")
