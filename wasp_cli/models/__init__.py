"""Networks: world model, critics, policies, denoiser, Q ensemble, safety value; and their weights
on disk.
"""
