"""`tofpod artefacts`: stored answers, each with the digests of what it hangs on, made again."""
