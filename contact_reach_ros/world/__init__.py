"""The surroundings of an arm: scenes, obstacles and goals (numpy only)."""
