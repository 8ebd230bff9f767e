"""Stress sets: motions that tell solvers apart, one module a kind, made from a seed for any arm."""
