"""`dano track`."""

from dano.cli.tracking._arguments import Track as Track
