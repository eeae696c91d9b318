"""Ways to reach a goal that the method is compared with; all see the same scenes, plant and metrics."""
