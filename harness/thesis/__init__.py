"""The claims of the thesis that the reference experiments repeat: their rules, their verdicts, their tables."""
