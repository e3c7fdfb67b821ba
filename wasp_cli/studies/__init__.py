"""What judges single parts: the time of a decision, and the planner on the true dynamics."""
