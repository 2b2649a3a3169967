"""Plans: textbook optima, push-and-slide, a drawer, random goals with nothing set."""
