"""Fits through impacts: whether they end, where from ten starts, and what their intervals hold."""
