"""Algorithm 1: sampling by CMA-ES and one gradient step per iteration, in a box of [-1, 1] on each variable."""
