"""Solvers over a network: a server that answers for registered solvers, and a client that is one."""
