"""Recognizes usual mistakes in the poses and cameras of photos, and names the option that fixes each."""
