"""`dano check`."""

from dano.cli.checking._arguments import Check as Check
