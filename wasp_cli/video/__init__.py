"""Episodes as films: cells played again, what the world model imagines for them, and what is
drawn of it.
"""
