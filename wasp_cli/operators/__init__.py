"""Operators: impaired policies, people, and clones of people."""
