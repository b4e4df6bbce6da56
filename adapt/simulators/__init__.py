"""Adapters that make third-party simulators plants, see `adapt.plants`; each needs its simulator installed."""
