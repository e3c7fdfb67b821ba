"""A model to what has to be done: cells, nodes, keys, schedule. Pure; imports no torch."""
