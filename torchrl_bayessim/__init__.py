"""Posteriors over a simulator's physics, policies trained under them, and the sim-to-real gap."""

from __future__ import annotations
