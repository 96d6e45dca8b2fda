"""Studies of the whole program, each a command: `python -m pssflow.study.demo`, `python -m pssflow.study.bench`."""
