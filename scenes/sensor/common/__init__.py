"""Parts that camera models of all kinds share: numbers with their source, units, random numbers."""
