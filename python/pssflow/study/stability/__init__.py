"""Planted failures: small cases that break methods of learned sampling, and what each guide makes of them.

A case is a file or a function, and a line in `registry.py`. `pssflow study stability` runs them all.
"""
