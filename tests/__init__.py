"""The tests of pssflow; a package, so that they share `tests.scenes`."""
