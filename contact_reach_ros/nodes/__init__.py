"""ROS 2 nodes, one file each: messages in, messages out."""

import os

# LAPACK works only on small matrices here. With more than one thread it waits for cores that the loops need, for up to
# 80 ms. NumPy and SciPy read this variable when they are first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
