"""Subcommands of `mimicik` that need an arm: one module a command."""
