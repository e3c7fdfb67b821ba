"""A small spec without a mistake."""

GOOD = """\
name: good
preset: smoke
tasks: [goal1]
methods: [human, wasp]
operators:
  noisy: {mild: 0.2}
seeds: [0]
"""
