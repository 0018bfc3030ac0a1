"""Gymnasium's classic control, many environments at once, each with parameters of its own."""
