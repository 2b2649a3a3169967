"""Films as a phone takes them: motions, place, light and sensor."""
