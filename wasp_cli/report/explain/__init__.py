"""Why an assistant did what it did, from stored rows: an episode, its facts, and these in words."""
