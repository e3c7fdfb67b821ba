"""Why an assistant did what it did: from the rows of a cell to facts, and from facts to tables.

    episode = read_episode(find_cell(layout, "611a4993"), 3)
    episode_lines(episode, width, command)    totals, runs of decisions under one gate, costs without a gate
    decision_lines(episode, 57, width)        one decision: command, gates, plan, what then happened
    episode_json(episode)                     as JSON values; decision_json(episode, 57) likewise

Tables use plain words, with the paper's symbols and equation numbers in brackets.
"""
