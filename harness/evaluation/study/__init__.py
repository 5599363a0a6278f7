"""Detection limits of studies: inspections and their outcomes, curves and bounds over boards,
comparisons."""
