"""The claims of the reference thesis: their rules, their verdicts and the inference of its unknown
set-up."""
