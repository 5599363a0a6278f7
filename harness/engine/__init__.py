"""From points to trials to records: the plan, the workers, the journal."""
