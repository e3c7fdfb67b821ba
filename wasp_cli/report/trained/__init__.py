"""What was trained for a report: its parts, their numbers as tables, their curves and pictures."""
