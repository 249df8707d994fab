"""How fast, how small: ``python -m benchmarks`` (or ``make bench``) measures all and writes the report."""
