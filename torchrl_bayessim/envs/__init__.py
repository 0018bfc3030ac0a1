"""Environments that step many simulators, each with physics of its own, in one native call."""
