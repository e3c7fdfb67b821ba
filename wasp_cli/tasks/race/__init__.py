"""Race: a car drives down a lane between fences and rocks, past bushes, to a goal."""
