"""Generation of scenes: random targets, obstacles in the arm's way, and scenes for other arms."""
