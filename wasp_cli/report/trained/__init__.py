"""What was trained for a report: the artifacts (`artifacts`), tables and figures of how good they
are (`tables`, `figures`), the pictures of each (`evidence`, `vectors`), and the same as series of
numbers for other programs (`series`).
"""
