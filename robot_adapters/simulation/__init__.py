"""Simulated motors and arms on a bus, their faults, and what proves a driver against them."""
