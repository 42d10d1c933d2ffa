"""Benchmarks: `python -m hqgs bench NAME`. Each is one file with a `BENCHMARK`, listed in `cli.py`."""
