"""Tasks of others: any gymnasium environment with `info["cost"]` and a camera image, named in a
spec by its id.
"""
