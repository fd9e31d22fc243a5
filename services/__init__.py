"""Companion services."""
