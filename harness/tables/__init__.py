"""Result tables: every column is declared once, and files, pages, terminals and
`results/README.md` render it."""
