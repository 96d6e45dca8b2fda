"""Programs to start from, each a file that runs by itself: `python -m pssflow.examples.NAME --help`."""
