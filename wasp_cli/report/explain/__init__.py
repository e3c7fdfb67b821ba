"""Why an assistant did what it did: from the rows of a cell to facts, and from facts to tables.

    episode = read_episode(find_cell(layout, "611a4993"), 3)
    summary = summarize(episode)              totals, runs of decisions under one gate, costs without a gate
    facts = decision_facts(episode, 57)       one decision: command, gates, plan, what then happened
    episode_lines(summary, width, command)    as tables; decision_lines(facts, width) likewise
    as_json(summary)                          as JSON values

Tables use plain words, with the paper's symbols and equation numbers in brackets.
"""
