"""Benchmarks: the paper's tables and figures, baselines, and measurements of the package's parts.

Run one from a checkout: `python -m benchmarks.table1 --targets 2`, or `make bench NAME=table1 ARGS="--targets 2"`.
"""

import os

# Before NumPy is imported: several threads of linear algebra, spinning, slow small matrices down.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
