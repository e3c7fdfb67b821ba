"""Numbers from the steps of an episode: the columns of the tables and the counterfactual
measures (numpy only).
"""
