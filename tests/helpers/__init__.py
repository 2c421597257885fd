"""What several tests share: builders of values, fakes, and flights in real processes."""
