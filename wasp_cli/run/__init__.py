"""A plan to a filled store: joblib workers, journal, progress."""
