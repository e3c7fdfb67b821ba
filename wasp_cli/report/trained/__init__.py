"""What was trained, for people: tables, figures, pages and pictures from the numbers that stages leave."""
