"""Simulated vessels, missions and sensors: boats whose true parameters are known. Needs torch."""
