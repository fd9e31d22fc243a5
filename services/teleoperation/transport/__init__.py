"""Transport between vehicle and station: several links at once, DTLS, deduplication, clock offsets.

Begin with `multipath`; `vehicle_side` connects, `station_side` accepts.
"""
