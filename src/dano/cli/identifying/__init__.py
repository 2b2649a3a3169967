"""`dano identify`."""

from dano.cli.identifying._arguments import Identify as Identify
