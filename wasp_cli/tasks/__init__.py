"""Constrained Markov decision processes on MuJoCo, stepped as batches."""
