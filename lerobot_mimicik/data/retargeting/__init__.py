"""End-effector recordings to joint space: reading, cleaning, placing, whole-trajectory IK, writing."""
