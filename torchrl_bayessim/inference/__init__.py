"""From a prior over parameters to a posterior given summary statistics."""
