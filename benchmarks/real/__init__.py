"""Real recordings: how well dano predicts what was measured, beside what others predict."""
