"""From measurements to errors: estimates, how sure they are, what can be known."""
