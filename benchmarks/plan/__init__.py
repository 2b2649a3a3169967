"""Plans: textbook optima, push-and-slide, a drawer."""
