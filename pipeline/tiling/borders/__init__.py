"""Borders: where tiles that were made apart meet, with the same vertices at the same height."""
