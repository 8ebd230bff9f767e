"""Kinematics of a serial arm: URDF, forward kinematics, rotations, poses and the FK consistency loss."""
