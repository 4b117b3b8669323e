// What a page adds to the discs of a recorded or served moment, so that it can be drawn.

// A scene of these discs; ground: its corners, where it has any.
export function dressed(agents, marks, lines, ground) {
  for (const agent of agents) {
    agent.goal = agent.colour < 0 ? -1 : marks.findIndex((mark) => mark.colour === agent.colour);
    agent.alarm = agent.lit;
  }
  return { agents, marks, lines, ground: ground[2] > ground[0] ? ground : null };
}

// The share of the marks that are lit.
export function shareLit(marks) {
  const there = marks.filter((mark) => mark.there);
  return there.length ? there.filter((mark) => mark.lit).length / there.length : 0;
}
