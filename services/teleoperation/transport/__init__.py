"""Transport between vehicle and station: multipath over several links, DTLS, deduplication, clock synchronization.

Begin with `multipath`; `vehicle_side` connects, `station_side` accepts.
"""
