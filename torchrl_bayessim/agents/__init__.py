"""Learners that plug into the loop: a policy and what improves it from batches."""
