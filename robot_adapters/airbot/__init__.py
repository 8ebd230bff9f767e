"""AIRBOT Play on a CAN bus: codecs, driver and a simulated arm.

Codecs: `protocol` (with `frames`, `od_motor`, `dm_motor`, `boards`, `gripper`). Driver: `arm` is its face;
below it `bus`, `startup`, `control`, `interpolation`, `feedback`, `gravity`, `statistics` and `settings`.
Simulation, with the extra `sim`: `simulated_arm` over `simulated_motor`, `plant`, `protection` and `faults`;
`cell` puts arm and driver together, `identification` fits the plant to a real log. Proof: `listener`,
`campaign` and `soak`.
"""
