"""Formula One: a car follows a walled circuit from stage to stage, among barrels."""
