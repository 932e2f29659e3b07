"""Simulators behind one protocol, with no PettingZoo in them."""
