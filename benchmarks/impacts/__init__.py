"""Impacts: what derivatives through them are worth, and where motion ends as steps shrink."""
