"""Guidance: exact, smooth and bounded commands on the way to a target; no torch, no solver, no robot.

`guided` is the face; below it `planner`, `descent`, `bounded_newton` and `kinematics_kernels` (compiled), `model`,
`settings`, `certificate`, `search`, `branches` and `user_terms`. `approach` and `box_step` are what solvers of other
kinds share.
"""
