"""A store to tables: pure functions over rows."""
