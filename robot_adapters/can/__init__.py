"""Driving motors with MIT frames on a CAN bus: bus, codecs, interpolation, feedback and the control loop."""
