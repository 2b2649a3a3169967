"""Impacts: what derivatives through them are worth, restitution, energy, and where motion ends as steps shrink."""
