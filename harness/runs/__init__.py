"""Points become trials and records: the plan, the workers, the journal."""
