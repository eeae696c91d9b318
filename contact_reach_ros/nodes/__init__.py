"""ROS 2 nodes; the only part of the package that imports rclpy."""

import os

# LAPACK is only used on small matrices here. On more than one thread it waits for cores that the loops need, up to
# 80 ms. NumPy and SciPy look at this when they are first imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
