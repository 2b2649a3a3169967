"""`dano track`, and how films are taken."""

from dano.cli.tracking._arguments import Filming as Filming, Track as Track
