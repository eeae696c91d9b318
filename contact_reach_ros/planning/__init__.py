"""Planning (Section III-C and III-D of the paper): transfer model, cost (5), Algorithm 1, receding horizon."""
