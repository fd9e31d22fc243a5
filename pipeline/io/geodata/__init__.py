"""Geographic formats: coordinate reference systems, GeoJSON, GeoTIFF, footprints, orthophotos, OpenDRIVE, STAC.

Start reading at `crs`.
"""
