"""Numbers from recorded steps."""
