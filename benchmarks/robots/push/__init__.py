"""The Panda pushes the shipped bunny with torques of its joints."""

from benchmarks.robots.push._case import panda as panda
