"""A model to what has to be done: cells, nodes, keys, waves. Pure; imports no torch."""
