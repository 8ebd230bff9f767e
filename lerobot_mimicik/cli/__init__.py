"""The `mimicik` command: one module a subcommand."""
