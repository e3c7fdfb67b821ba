"""The tables of a report: the type (`table`), the main ones (`main`), comparisons, along an axis, of people."""
