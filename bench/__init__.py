"""Side-by-side benchmarks; each ends with one line `RESULT {json}`."""
