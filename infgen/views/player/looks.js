// What Python says everything looks like, so that videos and strips look the same.

export const LOOKS = JSON.parse(document.querySelector("#looks").textContent);
