"""Goal: a point robot collects goals among hazards and vases."""
