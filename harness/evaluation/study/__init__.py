"""Detection limits of studies: what was inspected and how it fared, curves and bounds over boards, comparisons."""
