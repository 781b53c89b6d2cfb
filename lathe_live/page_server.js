// SPDX-License-Identifier: Apache-2.0
// Questions of a page to the server that it came from.
const PAGE_TOKEN = new URLSearchParams(location.search).get("token");
// Returns the answer; throws what the server says against the question.
async function ask(name, question = {}) {
  const headers = { "Content-Type": "application/json", "X-Lathe-Token": PAGE_TOKEN };
  const told = await fetch(`/ask/${name}`, { method: "POST", headers, body: JSON.stringify(question) });
  const found = told.headers.get("Content-Type")?.startsWith("application/json") ? await told.json() : { error: await told.text() };
  if (!told.ok) throw new Error(found.error);
  return found;
}
