"""Geographic formats: coordinate reference systems, GeoJSON, GeoTIFF, footprints, orthophotos, OpenDRIVE, STAC.

Begin with `crs`.
"""
