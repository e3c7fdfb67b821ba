"""Walking through results in a browser: from the table of cells to an episode, a decision and why (`wasp view`)."""
