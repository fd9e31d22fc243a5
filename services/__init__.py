"""Companion services: a room each, over one transport."""
