"""Learners: Bayesian networks that imitate the expert."""
