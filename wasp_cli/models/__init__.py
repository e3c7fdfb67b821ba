"""Networks: world model, critics, policies, denoiser, Q ensemble."""
