"""Metrics, rollouts and reports."""
