"""`dano check`."""

from dano.cli.checking._arguments import CheckScene as CheckScene
