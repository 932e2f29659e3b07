"""Eyes and the localisation pipeline."""
