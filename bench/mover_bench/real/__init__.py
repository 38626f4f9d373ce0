"""Real recordings with truth that others measured."""
