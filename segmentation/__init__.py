"""Semantic segmentation: classes per pixel of the photos, and from them classes per point of the cloud."""
