"""Answering with a trained policy, one query at a time."""
