"""Catalogue of faults, flown by real processes and judged by the vehicle's own record."""
