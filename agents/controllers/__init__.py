"""Controllers that move the robots."""
