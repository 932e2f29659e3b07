"""Datasets, runners, statistics and reports."""
